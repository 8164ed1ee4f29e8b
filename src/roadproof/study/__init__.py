"""Studies: many scenarios × figures × methods, on one machine or a cluster, to one table of rows."""
