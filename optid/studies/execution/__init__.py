"""Running cells: in worker processes of this machine or on a Dask cluster, into the database."""
