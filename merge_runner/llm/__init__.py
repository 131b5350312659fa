"""Calls to language models: cache, retry, limiter, transport, in this order."""
