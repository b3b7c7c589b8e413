# Types of the names that __init__.py imports on first use.
from .api import LodgsError as LodgsError
from .api import load_bundle as load_bundle
from .api import load_scene as load_scene
from .api import render_image as render_image
from .api import select as select
from .api import train as train

VERSION: str
