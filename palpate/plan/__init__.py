"""`palpate plan`: what an examination is going to do, before it does it."""
