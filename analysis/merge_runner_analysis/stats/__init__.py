"""One kind of number in each file, computed from the data frames of a study."""
