"""The seed paper's figures and claims, from runs of Palpate."""
