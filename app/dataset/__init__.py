"""The rating data set: columns, CSV and Parquet out and in, the data card."""
