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
# # Examine and look
#
# `palpate.run` is a whole examination: the camera looks, perception finds the skin, planning moves the arm over it, the
# assessment draws a map. It is what `palpate run` does, with the same run hash. Settings are keywords, each section of the
# scenario a mapping.

# %%
import matplotlib.pyplot as plt

import palpate

examination = palpate.run(
    "clean",
    exam={"region_m": [0.10, 0.10], "centre_m": [-0.055, -0.055]},  # the right lower quadrant
    camera={"frames": 10},
    record="none",
    quiet=True,
)
examination

# %% [markdown]
# ## Findings
#
# The ratio is that of the apparent stiffness, the force of a standard press, to its surroundings, with its 90 % band.

# %%
examination.findings

# %% [markdown]
# ## The map
#
# `map` has places, values and their band as arrays, and as a table. It is the examination's own opinion: nothing of the truth is
# in it.

# %%
figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4.2), layout="constrained")
examination.map.plot(left)
examination.map.plot(right, values=100 * examination.map.uncertainty, label="half width of the 90 % band [%]", cmap="cividis")
plt.show()

# %%
examination.map.frame.query("scanned").describe().round(3)

# %% [markdown]
# ## What was felt
#
# `samples` are what the assessment worked with, `states` what was measured over time. The force before the first contact is the
# sensor's bias: it is tared just before the arm goes down.

# %%
examination.samples.head()

# %%
figure, (force, depth) = plt.subplots(2, 1, sharex=True, figsize=(10, 4.5), layout="constrained")
states = examination.states
force.plot(states.time, states.force, lw=0.8)
force.set_ylabel("force [N]")
depth.plot(states.time, 1e3 * states.setpoint.clip(lower=-0.01), lw=0.8, label="set-point")
depth.plot(states.time, 1e3 * states.depth.clip(lower=-0.01), lw=0.8, label="measured")
depth.set(xlabel="time [s]", ylabel="depth [mm]")
depth.legend()
plt.show()

# %% [markdown]
# ## How good it was
#
# The report compares with what can truly be felt, which only the simulator knows, after the run.

# %%
scores = examination.report.scores
print(f"{scores.matched} matched, {scores.missed} missed, {scores.false_findings} false, Dice {scores.dice:.2f}")
print(f"run hash {examination.report.run_hash[:16]}, results in {examination.folder.parts[0]}/")

# %% [markdown]
# Any results folder can be opened again, one from the command line too: `palpate.Examination("out/clean-...")`. Its `page` is the
# report to read, and unless `record="none"` it has a `recording` for `palpate dashboard`.
