"""Why a trial went as it did: its class, what happened in words, and the moments to mark."""
