"""Models of motion: how a state moves from one time to the next, and how uncertain that is."""

from .base import LinearModel, Model, simulate

__all__ = ["LinearModel", "Model", "simulate"]
