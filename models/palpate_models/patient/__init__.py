"""The patient: body surface, tissue stiffness, breathing, motion and guarding."""
