"""Starting and conducting a run, with its processes or in one process."""
