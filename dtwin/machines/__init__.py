"""Virtual machines: mechanism with known truth, speaking the real protocols."""

__all__: list[str] = []
