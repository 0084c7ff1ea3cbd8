"""Robot poses: a robot is sent to many poses, and an instrument measures where its tool is."""

__all__: list[str] = []
