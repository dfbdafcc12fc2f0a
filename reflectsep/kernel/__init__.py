"""The paper's pixel problem as pointwise maps: what `solve` does for any model, for this one at the machine's speed."""
