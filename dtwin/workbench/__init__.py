"""The workbench: the same verbs and the same figures as the command line, in a browser."""

__all__: list[str] = []
