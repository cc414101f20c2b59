"""Off-line work on the law: the paper's cases, comparison, gains, tuning."""
