"""Strokes: coverage of the targets, paths over the surface, segments of arm motion, and the plan of an examination."""
