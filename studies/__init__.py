"""Published systems computed again, and what came of them told in full.

Scripts over what ``dtwin`` offers to everyone, with the sources' tables beside ours: ``*_paper`` answers figure by
figure, ``*_story`` and the rest are demos (``dtwin papers``, ``dtwin demo NAME``). Nothing in ``dtwin`` knows them but
the commands that start them.
"""
