"""The law: motion filter, disturbance observer, sliding control, references."""
