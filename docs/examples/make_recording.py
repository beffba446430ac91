"""Makes a small recording as a lab's robot would: presses on a simulated abdomen with one lump, as time, position and force.

python make_recording.py recording.csv
"""

import sys

import numpy as np
import pandas as pd

import palpate

RADIUS_M, CLEAR_M, STEP_S = 0.015, 0.015, 0.01


def recording(spacing=0.0125, depth=0.010, noise=0.02, seed=0):
    """Return the recording of a raster of presses: time [s], centre of the ball [m] and force on the tool [N]."""
    patient = palpate.Patient(palpate.scenario("clean", exam={"region_m": [0.1, 0.1], "centre_m": [-0.055, -0.055]}))
    heights = np.concatenate((np.arange(CLEAR_M, -depth, -0.0004), np.full(30, -depth), np.arange(-depth, CLEAR_M, 0.0008)))
    sides = np.arange(-0.105, 0.0, spacing)
    places, normals = patient.surface.points(np.array([(x, y) for x in sides for y in sides]))
    centres, forces = [], []
    for place, normal in zip(places, normals, strict=True):
        patient.rest(STEP_S)
        path = place + (RADIUS_M + heights[:, None]) * normal
        centres.append(path)
        forces.append([patient.move(p) for p in path])
    position, force = np.concatenate(centres), np.concatenate(forces)
    force = force + np.random.default_rng(seed).normal(0.0, noise, force.shape) + (0.4, -0.2, 1.1)  # noise, and no tare
    time = STEP_S * np.arange(len(position))
    return pd.DataFrame(np.column_stack((time, position, force)), columns=["t", "x", "y", "z", "fx", "fy", "fz"]).round(5)


if __name__ == "__main__":
    recording().to_csv(sys.argv[1], index=False)
