"""A sixth kind of campaign in one folder, as somebody else would add it: the error of a rotary table over a turn."""
