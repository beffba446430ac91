"""Commands that look at a live run or steer it."""
