"""The rating data set: its columns, CSV and Parquet out and in, and the data card.

``columns`` says what each column means, once, for files, preview and card. An import checks a whole file
before it writes anything.
"""
