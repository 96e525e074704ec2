"""Tests of distfilt.coupling."""
