"""Planning: sequence of the examination, coverage, pose generation, collision-free motion, timing, depth regulation.

The skin is the patient's own. The surface is the skin as the camera perceived it, once a scan. The wall is planning's estimate of
the skin now: the surface, corrected by touches and moved by the breath. Depth is counted from the wall.
"""
