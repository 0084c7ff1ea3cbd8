"""Kind ``rotation``: error motion of a turning axis after ISO 230-7, and run-out over speed."""

__all__: list[str] = []
