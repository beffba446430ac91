"""The KUKA LBR iiwa 7 R800 as tables, the default arm.

Kinematics, limits, masses and inertias: lbr_fri_ros2_stack, `iiwa7_description` and its joint limits. The capsules are ours.
"""

import numpy as np

from palpate_models.numerics.frames import frozen
from palpate_models.robot.chain import Arm, Capsule, Inertia

JOINT_NAMES = tuple(f"lbr_A{i}" for i in range(1, 8))
LINK_NAMES = (*(f"lbr_link_{i}" for i in range(8)), "lbr_link_ee")
"""The base, the link behind each joint, the flange."""


POSITION_LIMIT = frozen(np.deg2rad([170.0, 120.0, 170.0, 120.0, 170.0, 120.0, 175.0]))
"""Joint positions lie within +- this [rad], shape (7,)."""
VELOCITY_LIMIT = frozen(np.deg2rad([98.0, 98.0, 100.0, 130.0, 140.0, 180.0, 180.0]))
"""Joint speed limits [rad/s], shape (7,)."""
TORQUE_LIMIT = frozen([176.0, 176.0, 110.0, 110.0, 110.0, 40.0, 40.0])
"""Joint torque limits [N m], shape (7,)."""
HOME = frozen(np.deg2rad([0.0, -25.0, 0.0, -105.0, 0.0, 100.0, 0.0]))
"""Ready posture [rad], shape (7,): folded back over the base, tool straight down, the arm out of the camera's view."""

JOINT_ORIGIN = (
    (0.0, 0.0, 0.1475),
    (0.0, -0.0105, 0.1925),
    (0.0, 0.0105, 0.2075),
    (0.0, 0.0105, 0.1925),
    (0.0, -0.0105, 0.2075),
    (0.0, -0.0707, 0.1925),
    (0.0, 0.0707, 0.091),
)
"""Origin of joint i + 1 in its parent link i [m]."""
JOINT_AXIS = ((0, 0, 1), (0, 1, 0), (0, 0, 1), (0, -1, 0), (0, 0, 1), (0, 1, 0), (0, 0, 1))
LINK_7_TO_FLANGE_M = 0.035
ARM_INERTIA = (
    Inertia(4.855658, (-0.012857, 0.0, 0.069964), (0.017839, 0.022294, 0.021334), (0.0, 0.000781, 0.0)),
    Inertia(3.394011, (0.0, -0.034819, 0.123299), (0.021383, 0.020403, 0.007563), (0.0, 0.0, 0.003797)),
    Inertia(4.031991, (0.0, 0.039793, 0.086944), (0.031697, 0.030080, 0.009666), (0.0, 0.0, 0.005889)),
    Inertia(3.394011, (0.0, 0.034819, 0.123299), (0.021383, 0.020403, 0.007563), (0.0, 0.0, -0.003797)),
    Inertia(4.031989, (0.0, -0.039793, 0.086944), (0.031695, 0.030079, 0.009665), (0.0, 0.0, -0.005889)),
    Inertia(1.529239, (0.0, -0.029824, 0.076267), (0.008485, 0.007136, 0.003848), (0.0, 0.0, 0.002806)),
    Inertia(2.403626, (0.0, 0.07102, 0.00495), (0.007067, 0.006804, 0.004629), (0.0, 0.0, 0.000311)),
    Inertia(0.259474, (3e-6, -2e-6, 0.013782), (0.000171, 0.000171, 0.000299)),
)
"""Links 0 to 7."""

_ARM_CAPSULES = (
    (Capsule((-0.02, 0.0, 0.085), (0.0, 0.0, 0.10), 0.09),),
    (Capsule((0.0, 0.0, 0.035), (0.0, -0.035, 0.19), 0.077),),
    (Capsule((0.0, 0.035, 0.0), (0.0, 0.0105, 0.1675), 0.075),),
    (Capsule((0.0, 0.0, 0.035), (0.0, 0.035, 0.19), 0.077),),
    (Capsule((0.0, -0.035, 0.0), (0.0, -0.0105, 0.1675), 0.075),),
    (Capsule((0.0, 0.0, 0.03), (0.0, -0.012, 0.085), 0.071), Capsule((0.0, -0.055, 0.12), (0.0, -0.082, 0.1925), 0.06)),
    (Capsule((0.0, 0.048, 0.0), (0.0, 0.092, 0.0), 0.068), Capsule((0.0, 0.0707, 0.0), (0.0, 0.0707, 0.04), 0.055)),
    (Capsule((0.0, 0.0, 0.0), (0.0, 0.0, 0.005), 0.045),),
)

_SEEDS = tuple((0.0, tilt, 0.0, -bend, 0.0, 1.2, 0.0) for tilt in (0.3, 0.8) for bend in (1.6, 1.0))
"""Elbow up, the tool in front of the base."""

ARM = Arm(
    name="lbr",
    joint_names=JOINT_NAMES,
    link_names=LINK_NAMES,
    origin_m=frozen(JOINT_ORIGIN),
    axis=frozen(JOINT_AXIS),
    flange_m=frozen((0.0, 0.0, LINK_7_TO_FLANGE_M)),
    lower_rad=frozen(-POSITION_LIMIT),
    upper_rad=POSITION_LIMIT,
    velocity_radps=VELOCITY_LIMIT,
    torque_nm=TORQUE_LIMIT,
    acceleration_radps2=frozen([4.0, 4.0, 5.0, 5.0, 7.0, 7.0, 8.0]),
    stiffness_nmprad=frozen([800.0, 800.0, 600.0, 600.0, 400.0, 300.0, 200.0]),
    hold_damping_nms=frozen([100.0, 100.0, 80.0, 80.0, 40.0, 40.0, 20.0]),
    home_rad=HOME,
    inertias=ARM_INERTIA,
    capsules=_ARM_CAPSULES,
    seeds_rad=_SEEDS,
)
