"""Evaluates recorded predictions: scores, strata, temperatures, fusion. Imports no network."""
