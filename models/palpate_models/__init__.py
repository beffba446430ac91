"""Robot, phantoms and scenarios: what the services share about the world, without knowing the bus."""
