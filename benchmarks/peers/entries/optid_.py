"""optid itself."""

import optid

CANNOT = {}


def predictors(model):
    return {"one_step": lambda u, y: model.predict(optid.Data(u=u, y=y)), "simulate": lambda u, y: model.simulate(u)}


def hammerstein(r):
    fit = optid.fit(optid.Data(u=r["u"], y=r["y"]), "hammerstein_arx.exact", na=r["na"], nb=r["nb"], nk=r["nk"],
                    basis=optid.Polynomial(r["degree"]))
    return predictors(fit.model)


missing = hammerstein


def constrained(r):
    nodes = r["nodes"]
    fit = optid.fit(optid.Data(u=r["u"], y=r["y"]), "hammerstein_arx.exact", na=r["na"], nb=r["nb"], nk=r["nk"],
                    basis=optid.Triangular(len(nodes) - 1, interval=(nodes[0], nodes[-1])),
                    constraints=["monotone:increasing", "gain:1.0"])
    return predictors(fit.model)


def state_space(r):
    fit = optid.fit(optid.Data(u=r["u"], y=r["y"]), "ss.exact", nx=r["nx"], criterion="prediction",
                    offset=False, feedthrough=False)
    return predictors(fit.model)
