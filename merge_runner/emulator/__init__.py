"""The emulator: a mock model in place of a provider."""
