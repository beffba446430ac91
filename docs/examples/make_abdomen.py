"""Write a mesh: half an ellipsoid on a flat back, in metres and in the abdomen frame."""

import sys

import trimesh

belly = trimesh.creation.icosphere(subdivisions=4)
belly.apply_scale((0.19, 0.24, 0.10))  # x to the patient's left, y to the head, z outward
belly.apply_translation((0.0, 0.0, -0.10))  # the umbilicus is the origin
belly.vertices[:, 2] = belly.vertices[:, 2].clip(min=-0.15)  # flat on its back
belly.export(sys.argv[1] if len(sys.argv) > 1 else "my_abdomen.stl")
