"""A workshop for the accuracy of machine tools and robots."""

__version__ = "0.1.0"
