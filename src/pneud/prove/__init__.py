"""The whole daemon in one process: its shipped functions as actors under a virtual clock and one seed."""
