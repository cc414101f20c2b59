"""The page in the browser, and the facts of a status as metrics; in processes beside the daemon."""
