"""Figures and claims of the seed paper, reproduced by runs of Palpate."""
