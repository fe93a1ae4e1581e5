from . import publish as publish
