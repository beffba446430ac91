"""Conducts a run: the `palpate` command, start, pacing, watchdog, scores and report."""
