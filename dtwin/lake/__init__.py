"""The lake: Parquet tables of runs, samples and signals, with a log of commits."""

__all__: list[str] = []
