"""Figures and claims of the original paper, reproduced by runs of Palpate."""
