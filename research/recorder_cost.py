"""Cost of recording: time per message and bytes on disk, by compression, for the traffic of an examination in contact.

python -m research.recorder_cost [SIMULATED SECONDS]
"""

import sys
import tempfile
from pathlib import Path
from time import perf_counter, process_time
from typing import Any

import numpy as np
from mcap.writer import CompressionType

from palpate_bus.contract import contract
from palpate_bus.messages import (
    MS,
    Duration,
    JointState,
    JointTorqueCommand,
    Point,
    Pose,
    Quaternion,
    SurfaceMesh,
    ToolState,
    Twist,
    Vector3,
    Wrench,
    WrenchStamped,
    codec,
    header,
)
from palpate_recorder.bag import BagWriter
from palpate_recorder.service import channels


def traffic(seconds: float) -> list[tuple[str, bytes, int, int]]:
    """Five 1 kHz topics with noise in every digit, and a surface of 3,000 vertices at 20 Hz that a dent moves over."""
    random = np.random.default_rng(0)
    grid = np.stack(np.meshgrid(np.linspace(-0.18, 0.18, 50), np.linspace(-0.2, 0.2, 60)), axis=-1).reshape(-1, 2)
    triangles = random.integers(0, 3000, 17_700).astype(np.uint32)
    names = [f"joint_{i}" for i in range(1, 8)]
    found = []

    def add(topic: str, message: Any, t: int, sequence: int) -> None:
        found.append((f"/{topic}", codec.encode(message, contract().topics[topic].type), t, sequence))

    def vector() -> Any:
        return Vector3(*random.normal(size=3))

    for i in range(int(seconds * 1000)):
        t = i * MS
        joints = np.sin(t / 1e9 + np.arange(7)) + 1e-6 * random.normal(size=7)
        wrench = Wrench(vector(), vector())
        pose = Pose(Point(*random.normal(size=3)), Quaternion(0.0, 0.0, 0.0, 1.0))
        add("joint_states", JointState(header(t), names, joints, 1e-4 * random.normal(size=7), 10 * joints), t, i)
        add("ft/wrench", WrenchStamped(header(t, "ft_sensor"), wrench), t, i)
        add("sim/contact_wrench", WrenchStamped(header(t, "world"), wrench), t, i)
        add("sim/tool_state", ToolState(header(t, "world"), pose, Twist(vector(), vector()), 0.015), t, i)
        command = JointTorqueCommand(header(t), random.normal(size=7), np.zeros(0), Duration(0, 50 * MS), "", "")
        add("control/joint_torque", command, t, i)
        if i % 50 == 0:
            dent = 0.01 * np.exp(-((grid - (0.1 * np.sin(t / 1e9), 0)) ** 2).sum(axis=1) / 8e-4)
            vertices = np.column_stack((grid, -dent)).astype(np.float32).ravel()
            mesh = SurfaceMesh(header(t, "world"), vertices, np.empty(0, np.float32), triangles, np.empty(0, np.float32))
            add("sim/surface", mesh, t, i // 50)
    return found


def main() -> None:
    """Print the table."""
    seconds = float(sys.argv[1]) if len(sys.argv) > 1 else 10.0
    messages = traffic(seconds)
    size = sum(len(payload) for _, payload, _, _ in messages)
    print(f"{len(messages)} messages, {size / 1e6 / seconds:.2f} MB a simulated second")
    print("| compression | us a message | us a message, p99.9 | ms a simulated second | MB a simulated second |")
    print("|---|---|---|---|---|")
    for compression in (CompressionType.NONE, CompressionType.LZ4, CompressionType.ZSTD):
        with tempfile.TemporaryDirectory() as folder:
            bag = BagWriter(Path(folder) / "bag", channels(contract(), full=True), compression=compression)
            spent = np.empty(len(messages))
            cpu = process_time()
            for i, (topic, payload, stamp, sequence) in enumerate(messages):
                start = perf_counter()
                bag.write(topic, payload, stamp, sequence)
                spent[i] = perf_counter() - start
            bag.close()
            cpu = process_time() - cpu
            written = bag.paths[0].stat().st_size
        print(
            f"| {compression.name.lower()} | {1e6 * cpu / len(messages):.1f} | {1e6 * np.quantile(spent, 0.999):.0f} "
            f"| {1e3 * cpu / seconds:.0f} | {written / 1e6 / seconds:.2f} |"
        )


if __name__ == "__main__":
    main()
