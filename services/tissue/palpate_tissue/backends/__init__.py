"""Implementations of the role tissue, each behind `palpate_tissue.backend.TissueBackend` or, for FMUs, a service of its own."""
