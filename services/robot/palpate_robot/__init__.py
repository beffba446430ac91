"""The robot: physics (`plant`), sensor (`ft_sensor`), driver (`driver`), and the service that puts them on the bus."""
