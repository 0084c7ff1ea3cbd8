"""Kind ``drift``: one displacement against logged temperatures, after ISO 230-3."""

__all__: list[str] = []
