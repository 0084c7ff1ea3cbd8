"""The same work for many machines: in this process, in several, or on the workers of a Dask scheduler."""

__all__: list[str] = []
