"""Planning: the exam state machine, coverage execution, pose generation, collision-free motion, timing, depth regulation."""
