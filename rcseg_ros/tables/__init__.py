"""Results as Parquet tables: `schema` says what the columns mean, `rows` takes them from a result, `sink`
puts the rows of a replay in order, `parquet` writes and reads the files.

pyarrow is asked for here alone, and only by whoever wants tables (`extras`). May import recordings and what
lies below; for others are `parquet.open_table`, `parquet.read_labels` and the names of `schema`.
"""
