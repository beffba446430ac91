"""`palpate plan`: draws the plan of an examination."""
