"""Optimizers beyond those of torch."""

from phd_exp.optimizers.muon import Muon

__all__ = ["Muon"]
