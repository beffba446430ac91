"""`palpate arm`: check an arm, place its base."""
