"""From datasets to what training sees."""
