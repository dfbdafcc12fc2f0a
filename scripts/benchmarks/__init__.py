"""What `scripts/benchmark.py` measures: the common problem, the yardstick in C++, and the competitors."""
