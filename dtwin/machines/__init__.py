"""Virtual machines: mechanism with known truth, speaking the real protocols."""
