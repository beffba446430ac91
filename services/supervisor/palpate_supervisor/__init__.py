"""Safety supervisor: stops the examination when what the sensors say leaves the limits."""
