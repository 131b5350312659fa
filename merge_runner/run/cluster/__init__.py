"""A sweep on several machines: Dask runs batches of trials, one coordinator keeps the books."""
