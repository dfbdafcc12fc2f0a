"""Settings of all tests."""

from hypothesis import settings

# How long an example takes on a busy machine is no property of the code.
settings.register_profile("reflectsep", deadline=None)
settings.load_profile("reflectsep")
