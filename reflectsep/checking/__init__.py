"""The check job: what a capture will bear, before anyone spends time on a fit; findings with numbers and verdicts."""
