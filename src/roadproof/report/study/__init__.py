"""What a study found, shown: the paper's tables with intervals, figures, one page of both."""
