"""Reports for people: scores per bin, tables, figures, and the paper's numbers beside."""
