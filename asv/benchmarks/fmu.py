"""A step of the abdomen's FMU: through FMPy, and through the prepared ctypes calls that the tissue service uses."""

import tempfile
from pathlib import Path

import fmpy
import numpy as np
from fmpy.simulation import instantiate_fmu

from palpate_fmu.compiling import native
from palpate_fmu.export import build_fmu
from palpate_fmu.instance import FmuInstance
from palpate_models.patient.phantom import build_phantom
from palpate_models.patient.schema import Lesion, Phantom

MOTION, WRENCH = [1, 4], [10, 13]
"""Value references of position and velocity, and of force and torque."""


class Step:
    """The default abdomen with a lesion, held 10 mm deep."""

    params = ["fmpy", "ctypes"]  # noqa: RUF012 - the form that asv reads
    param_names = ("by",)
    timeout = 300
    radius_m, depth_m, step_s = 0.015, 0.010, 1e-3

    def setup_cache(self) -> str:
        """Compile the FMU once."""
        path = Path(tempfile.mkdtemp(prefix="palpate-asv-")) / "abdomen.fmu"
        phantom = Phantom(lesions=(Lesion(centre_m=(-0.055, 0.01)),))
        build_fmu(phantom, 0, path, 3, [native()], self.radius_m, build_phantom(phantom, seed=0))
        return str(path)

    def setup(self, path: str, by: str) -> None:
        """Load the FMU and press."""
        model = build_phantom(Phantom(), seed=0)
        top = float(model.vertices[np.hypot(*model.vertices[:, :2].T).argmin(), 2])
        self.position, self.velocity, self.k = np.array((0.0, 0.0, top + self.radius_m - self.depth_m)), np.zeros(3), 0
        if by == "fmpy":
            folder = tempfile.mkdtemp(prefix="palpate-asv-")
            fmpy.extract(path, unzipdir=folder)
            self.fmu = instantiate_fmu(folder, fmpy.read_model_description(path), "CoSimulation")
            self.fmu.enterInitializationMode()
            self.fmu.exitInitializationMode()
        else:
            self.fmu = FmuInstance(Path(path)).__enter__()
            self.motion = self.fmu.port(["indenter_position", "indenter_velocity"])
            self.wrench = self.fmu.port(["contact_force", "contact_torque"])

    def time_step(self, _path: str, by: str) -> None:
        """Set the motion, step, read the wrench."""
        self.k += 1
        if by == "fmpy":
            self.fmu.setFloat64(MOTION, [*self.position, *self.velocity])
            self.fmu.doStep(self.k * self.step_s, self.step_s)
            self.fmu.getFloat64(WRENCH, 6)
        else:
            self.motion["indenter_position"][:] = self.position
            self.motion["indenter_velocity"][:] = self.velocity
            self.motion.push()
            self.fmu.step(self.k * self.step_s, self.step_s)
            self.wrench.pull()

    def teardown(self, _path: str, by: str) -> None:
        """Free the FMU."""
        if by == "fmpy":
            self.fmu.terminate()
            self.fmu.freeInstance()
        else:
            self.fmu.__exit__(None, None, None)
