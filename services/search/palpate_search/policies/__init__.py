"""Policies: functions of the posterior and the remaining budget that return place [m] and depth [m]."""
