"""What people see of a fit: the printed result, tables and drawings."""
