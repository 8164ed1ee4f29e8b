"""Pictures, tables and pages made of results."""
