"""Distributed nonlinear filtering: transport maps, mixtures, densities and their networks.

The modules are imported one by one, ``from distfilt.filters.ensemble import EnsembleFilter``, so
that ``import distfilt`` costs no more than numpy.
"""

__all__ = ["__version__"]

__version__ = "0.1.0"
