"""Commands that inspect or control a live run."""
