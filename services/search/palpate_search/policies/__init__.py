"""Policies: each is one function of the posterior and the budget that is left, and returns place [m] and depth [m]."""
