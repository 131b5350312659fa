"""The pages: each takes what an address says and returns HTML."""
