"""Evaluates recorded predictions: scores, strata, temperatures, guarantees, fusion. Imports no network."""
