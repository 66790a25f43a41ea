"""Measures recorded predictions: scores, strata, temperatures, fusion. Knows no network."""
