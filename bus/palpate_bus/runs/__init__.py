"""Announcing, finding and operating the runs of this machine."""
