"""The reflectance problem (paper, section 5): start values, priors, and the joint fit."""
