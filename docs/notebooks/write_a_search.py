# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # Write a search
#
# A raster presses everywhere. A search chooses each press from the ones before. This one is a
# loop of five lines: **press where the posterior is most uncertain**.

# %%
import matplotlib.pyplot as plt
import numpy as np

import palpate

chosen = palpate.scenario("clean", exam={"region_m": [0.16, 0.16]})
patient = palpate.Patient(chosen)


def press(xy):
    """A short press that is held long enough to count."""
    return patient.press(xy, depth=0.010, speed=0.05, hold=0.5)


# %% [markdown]
# ## Begin
#
# The assessment wants a few presses before it says anything. Nine over the region will do.

# %%
touches = [press((x, y)) for y in (-0.06, 0.0, 0.06) for x in (-0.06, 0.0, 0.06)]
found = palpate.assess(touches)
found

# %% [markdown]
# `palpate.assess` is the assessment of the system, with the same inputs: the perceived skin, and force and depth
# over time, without the patient.

# %% [markdown]
# ## Search
#
# The map holds apparent stiffness with its 90 % band at every place, also where no press was made. The next press is where
# the band is widest.


# %%
def most_uncertain(posterior, exam):
    """The place of the examined region where the band of the map is widest, xy [m]."""
    places = posterior.vertices[:, :2]
    inside = (np.abs(places - exam.centre_m) <= 0.5 * np.array(exam.region_m)).all(axis=1)
    return places[np.argmax(np.where(inside, posterior.uncertainty, 0.0))]


history = [found]
while len(touches) < 25:
    touches.append(press(most_uncertain(history[-1].map, chosen.exam)))
    history.append(palpate.assess(touches))

# %% [markdown]
# ## Look at it
#
# Dots are presses, the newest has a ring. The search goes where it knows least: to the corners, and about whatever stands out.

# %%
figure, rows = plt.subplots(2, 3, figsize=(13, 7.5), layout="constrained")
for axes, k in zip(rows.T, (0, 8, 16), strict=True):
    felt, band = history[k].map, 100 * history[k].map.uncertainty
    felt.plot(axes[0])
    felt.plot(axes[1], values=band, label="half width of the 90 % band [%]", cmap="cividis")
    places = 1e3 * np.array([touch.position[-1, :2] for touch in touches[: 9 + k]])
    for panel in axes:
        panel.plot(*places.T, "o", ms=3, color="white")
        panel.plot(*places[-1], "o", ms=7, mfc="none", mec="white")
    axes[0].set_title(f"{9 + k} presses")
plt.show()

# %% [markdown]
# ## Against the truth
#
# The patient knows. Here is what was found, over the true stiffness of the wall. Only a place within reach of a press can belong
# to a finding, so that few presses leave gaps.

# %%
final = history[-1]
x, y = np.meshgrid(np.linspace(-0.08, 0.08, 81), np.linspace(-0.08, 0.08, 81))
true = patient.stiffness(np.column_stack((x.ravel(), y.ravel()))).reshape(x.shape)

figure, axes = plt.subplots(figsize=(6, 5), layout="constrained")
figure.colorbar(axes.pcolormesh(1e3 * x, 1e3 * y, 1e-6 * true, cmap="inferno"), label="foundation modulus [N/cm³]")
nodes = final.map.frame.query("finding >= 0")
axes.plot(1e3 * nodes.x_m, 1e3 * nodes.y_m, "s", ms=3, color="cyan", label="found")
axes.set(aspect="equal", xlabel="x, to the patient's left [mm]", ylabel="y, to the head [mm]")
axes.legend()
plt.show()
final.findings

# %% [markdown]
# ## As a policy
#
# A search that is a function of posterior and remaining budget is a policy: the same function presses a patient here, and drives
# the arm with `palpate run --set exam.pattern=search --set search.policy=FILE`. The default policy maximises information per
# second. This patient breathes, and the equipment has errors.

# %%
from palpate.search.trial import PatientHand, search  # noqa: E402
from palpate_search.posterior import policy  # noqa: E402

trial = search(PatientHand(palpate.scenario("lump", seed=7)), policy("informed"), presses=20)
plt.plot(trial.seconds, trial.lump, label="there is a lump")
plt.plot(trial.seconds, trial.near, label="it is near the most probable place")
plt.xlabel("time [s]")
plt.ylabel("probability")
plt.legend()
plt.show()

# %% [markdown]
# ## Yours
#
# Try another function of the map: the place where the apparent stiffness is greatest, a press and its
# uncertainty together, or a `slide` where it gives more information per second. Compare on patients who breathe:
# `palpate.Patient("lump", seed=7)`, and decide when to stop. [Search](../search.md) compares ten policies.
