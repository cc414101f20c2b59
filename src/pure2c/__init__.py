"""Pure functions of Python, compiled: the same to the last bit. README.md has what that takes."""

from pure2c.build import Built, compile_functions, load_source
from pure2c.types import BuildError, TranslationError

__all__ = ["BuildError", "Built", "TranslationError", "compile_functions", "load_source"]
