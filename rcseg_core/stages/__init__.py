"""The passes of the algorithm, each a few calls into the rooms below; `pipeline` calls them in turn.

May import: every room but `resampling`. For others: what `pipeline` and `resampling` call. A stage that
changes signals or edges returns them; only partitions are changed in place.
"""
