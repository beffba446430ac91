"""A patient who moves: a service that carries any tissue service along."""
