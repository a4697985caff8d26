"""The catalogue of identification problems: one file per problem, each entry returns a Program or a Procedure."""
