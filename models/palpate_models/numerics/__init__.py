"""Arrays, frames, compiled functions and caches, without any knowledge of palpation."""
