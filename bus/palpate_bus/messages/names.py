"""Message classes of `palpate_bus.messages` by ROS package. Short names are unique."""

from __future__ import annotations

PACKAGES: dict[str, tuple[str, ...]] = {
    "builtin_interfaces": ("Duration", "Time"),
    "diagnostic_msgs": ("DiagnosticArray", "DiagnosticStatus", "KeyValue"),
    "geometry_msgs": (
        "Point", "Pose", "PoseStamped", "Quaternion", "Transform", "TransformStamped", "Twist", "Vector3", "Wrench",
        "WrenchStamped",
    ),
    "nav_msgs": ("Path",),
    "palpation_msgs": (
        "Advance", "CameraTrigger", "ExamState", "Finding", "Findings", "ImpedanceSetpoint", "IndentationTruth",
        "JointTorqueCommand", "OperatorRequest", "PalpationSample", "PalpationTargets", "PatientTruth", "PhantomTruth",
        "RecordChunk", "RobotStatus", "RunControl", "SearchRequest", "ServiceReport", "SkinTouch", "StiffnessMap",
        "SupervisorState", "SurfaceCorrection", "SurfaceMesh", "SurfaceMotion", "ToolState",
    ),
    "rosgraph_msgs": ("Clock",),
    "sensor_msgs": ("CameraInfo", "Image", "JointState", "PointCloud2", "PointField", "RegionOfInterest"),
    "std_msgs": ("Header", "String"),
    "tf2_msgs": ("TFMessage",),
}  # fmt: skip

TYPE_NAMES: dict[str, str] = {name: f"{package}/msg/{name}" for package, names in PACKAGES.items() for name in names}
"""Full type name of each class: `TYPE_NAMES["JointState"]` is `sensor_msgs/msg/JointState`."""
