"""Runs by the thousand: of a file with parameters and distributions, on all cores or on a cluster, as rows.

`unit.run(config, seed)` is the only thing that runs; all else says which runs there are, hands them out,
keeps what comes back, and shows it.
"""
