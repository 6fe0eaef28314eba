"""Seeded randomness and hypothesis settings for every test."""

import numpy as np
import pytest
from hypothesis import settings

# The first call of a kernel compiles it: no deadline. Derandomized, so that every run tests the same cases.
settings.register_profile("project", deadline=None, derandomize=True, max_examples=50)
settings.load_profile("project")


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(20260601)
