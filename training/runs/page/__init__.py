"""A page to share: levels in a browser, with PlayCanvas' viewer (``tools/viewer.py``)."""
