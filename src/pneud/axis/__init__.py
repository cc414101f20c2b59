"""One axis: its cycle, and what becomes of requests. Neither clock nor I/O."""
