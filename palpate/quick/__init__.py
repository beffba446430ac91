"""The quick tier: the true tissue and an indenter that moves through it as whole examinations do, without an arm and a bus."""
