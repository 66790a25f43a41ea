"""How a network's numbers step, given their gradients."""

from phd_exp.optimizers.muon import Muon

__all__ = ["Muon"]
