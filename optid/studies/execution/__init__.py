"""Running cells: in worker processes or on a cluster, with limits, one row for each whatever happens."""
