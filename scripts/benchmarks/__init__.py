"""The fit's solver, and what it is measured against."""
