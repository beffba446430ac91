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
# # Press a patient
#
# A patient is an object here: press him, slide over him, and look at what the indenter felt. It is the tissue of the whole
# system and its contact, without an arm, without other processes and without a bus.

# %%
import matplotlib.pyplot as plt
import numpy as np

import palpate

patient = palpate.Patient("clean", seed=1)

# %% [markdown]
# Lengths are in metres, forces in newtons, times in seconds. The frame is that of the abdomen: the umbilicus is (0, 0), x
# goes to the patient's left and y to the head. This patient has a lump in the right lower quadrant, about (-55, -55) mm.
# Press it, and the same place on the opposite side.

# %%
on_lump = patient.press((-0.055, -0.055), depth=0.010, speed=0.02, hold=3.0)
opposite = patient.press((0.055, -0.055), depth=0.010, speed=0.02, hold=3.0)

figure, (left, right) = plt.subplots(1, 2, figsize=(10, 3.5), layout="constrained")
for touch, words in ((on_lump, "on the lump"), (opposite, "opposite side")):
    left.plot(touch.time - touch.time[0], touch.force, label=words)
    down = ~touch.steady
    right.plot(1e3 * touch.depth[down], touch.force[down], label=words)
left.set(xlabel="time [s]", ylabel="force [N]", title="pressed, and held")
right.set(xlabel="depth [mm]", ylabel="force [N]", title="on the way down")
left.legend()
plt.show()

# %% [markdown]
# The force rises faster than the depth: the sphere touches more and more skin. And while the depth is held the
# force sinks: the wall relaxes.

# %%
print(f"greatest force: {on_lump.force.max():.1f} N on the lump, {opposite.force.max():.1f} N on the opposite side")
print(f"after 3 s it is {100 * opposite.force[-1] / opposite.force.max():.0f} % of the greatest on the opposite side")

# %% [markdown]
# ## Faster is harder
#
# The force depends on the speed of the press. The tissue recovers slowly from a press, so the patient rests for a minute before
# each one.

# %%
speeds = [0.005, 0.02, 0.08]
for speed in speeds:
    patient.rest(60.0)
    touch = patient.press((0.055, 0.03), depth=0.010, speed=speed, hold=0.0)
    plt.plot(1e3 * touch.depth, touch.force, label=f"{1e3 * speed:.0f} mm/s")
plt.xlabel("depth [mm]")
plt.ylabel("force [N]")
plt.legend()
plt.show()

# %% [markdown]
# ## Slide
#
# A slide feels a whole line at once. This one goes across the lump.

# %%
slide = patient.slide([(-0.10, -0.055), (0.0, -0.055)], depth=0.010, speed=0.03)
at_depth = slide.steady
plt.plot(1e3 * slide.position[at_depth, 0], slide.force[at_depth])
plt.xlabel("x, to the patient's left [mm]")
plt.ylabel("force [N]")
plt.show()

# %% [markdown]
# ## What is true
#
# The patient object knows the truth and shows it: the skin at rest, and the stiffness of the wall at each
# place. No examination is ever given it.

# %%
x, y = np.meshgrid(np.linspace(-0.12, 0.12, 121), np.linspace(-0.12, 0.12, 121))
xy = np.column_stack((x.ravel(), y.ravel()))
height = patient.surface.height(xy).reshape(x.shape)
stiffness = patient.stiffness(xy).reshape(x.shape)

figure, axes = plt.subplots(figsize=(6, 5), layout="constrained")
image = axes.pcolormesh(1e3 * x, 1e3 * y, 1e-6 * stiffness, cmap="inferno")
figure.colorbar(image, label="foundation modulus [N/cm³]")
lines = axes.contour(1e3 * x, 1e3 * y, 1e3 * height, colors="white", linewidths=0.6)
axes.clabel(lines, fmt="%.0f mm")
axes.plot(1e3 * slide.position[:, 0], 1e3 * slide.position[:, 1], "c--", label="the slide")
axes.legend()
axes.set(aspect="equal", xlabel="x, to the patient's left [mm]", ylabel="y, to the head [mm]")
plt.show()
