"""Planning: sequence of the examination, coverage, pose generation, collision-free motion, timing, depth regulation."""
