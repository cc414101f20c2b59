"""Many logs as one table: a row for each motion, so that what is asked of a year takes seconds."""
