"""Convert, inspect and validate Gaussian splat assets."""

__version__ = "0.1.0"
