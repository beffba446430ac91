"""Any co-simulation FMU as a service: a YAML map ties its variables to topic fields. See the README."""
