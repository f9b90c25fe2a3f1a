# The compiled bindings come without stubs; pyright would report every name of theirs as unknown.
from typing import Any

def __getattr__(name: str) -> Any: ...
