"""The emulator: a mock model in the place of a provider, with a scripted driver behind it."""
