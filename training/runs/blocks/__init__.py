"""A scene that is too large for one run: cells of it are trained one by one, here or on other computers, and
put together. A block is the ordinary run of a cell."""
