"""The soft abdomen as an FMU: `build_fmu` writes one, `palpate.fmu` looks at and simulates any. See the README."""

from palpate_fmu.export import build_fmu

__all__ = ["build_fmu"]
