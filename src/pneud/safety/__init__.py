"""What stands between the law and the valve: fault table, supervisor, output chain."""
