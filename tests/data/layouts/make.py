"""Writes catalogues of 64 galaxies in the columns of surveys and pipelines, and layouts.json with what numpy gives for them.

    python3 tests/data/layouts/make.py

The names are those of the releases and of the code that writes them: DES Y3 and Y6 (Gatti et al. 2021; Yamamoto et al. 2025), HSC S19A
(Li et al. 2022), Euclid's SHE LensMC, KiDS-1000, SKiLLS (KiDS-WL/MultiBand_ImSim), UNIONS, LSST's Object table, DECADE
(delve-survey/shearcat), BFD (Bernstein & Armstrong 2014: P, Q and R), metadetect, ShapePipe and TXPipe.
"""

import json
import pathlib

import numpy as np

HERE = pathlib.Path(__file__).parent
SIDE, STAMP, STEP = 8, 48, 0.01
N = SIDE * SIDE
SHEARED = ["1p", "1m", "2p", "2m"]
ADDED = {"noshear": (0, 0), "1p": (STEP, 0), "1m": (-STEP, 0), "2p": (0, STEP), "2m": (0, -STEP)}


def solve(e, g, w, R):
    """m and c of both components: sums of w e and w e g_i equal those of w R ((1 + m) g + c)."""
    A, b = np.zeros((4, 4)), np.zeros(4)
    for i in range(2):
        for k, instrument in enumerate((np.ones(len(w)), g[i])):
            b[2 * i + k] = np.sum(w * e[i] * instrument)
            for j in range(2):
                A[2 * i + k, 2 * j] = np.sum(w * R[i][j] * g[j] * instrument)
                A[2 * i + k, 2 * j + 1] = np.sum(w * R[i][j] * instrument)
    a1, c1, a2, c2 = np.linalg.solve(A, b)
    return dict(m1=a1 - 1, c1=c1, m2=a2 - 1, c2=c2)


def mean_shear(e, w, R):
    """The weighted mean of e over that of R."""
    mean = lambda x: np.sum(w * x) / np.sum(w)
    return np.linalg.solve([[mean(R[i][j] * np.ones(len(w))) for j in range(2)] for i in range(2)], [mean(e[0]), mean(e[1])])


class Layout:
    def __init__(self, name, seed, given=(), matrix=True):
        self.name, self.given, self.random = name, list(given), np.random.default_rng(seed)
        r = self.random
        self.g = np.array([r.choice([-0.04, 0.01, 0.05], N), r.choice([-0.03, 0.02, 0.04], N)])
        self.R = 0.7 * np.eye(2)[:, :, None] + 0.15 * r.normal(size=(2, 2, N)) * (1 if matrix else np.eye(2)[:, :, None])
        self.e = 0.05 * r.normal(size=(2, N)) + np.einsum("ijn,jn->in", self.R, self.g)
        self.w = r.uniform(0.5, 2, N)
        self.flag = (np.arange(N) % 9 == 4) * 3
        ix, iy = np.divmod(np.arange(N), SIDE)
        self.places = dict(x=STAMP * (ix + 0.5) + 0.5, y=STAMP * (iy + 0.5) + 0.5)

    def psf(self):
        return 0.03 * self.random.normal(size=(2, N))

    def write(self, columns, e, R, good, w=None, truth=True, rows=None):
        """The catalogue, and the expected values: `good` galaxies count, with ellipticities e, responses R and weights w."""
        w = np.ones(N) if w is None else w
        columns = dict(columns)
        if truth:
            columns |= dict(g1_true=self.g[0], g2_true=self.g[1])
        columns |= self.places
        names = list(columns)
        table = [[columns[name][at] for name in names] for at in range(N)] if rows is None else rows(columns)
        text = [",".join(names)] + [",".join(field if isinstance(field, str) else f"{field:.10g}" for field in row) for row in table]
        (HERE / f"{self.name}.csv").write_text("\n".join(text) + "\n")
        # As the file has them.
        rounded = lambda x: np.array([float(f"{v:.10g}") for v in np.ravel(x)]).reshape(np.shape(x))
        e, w, g = rounded(e), rounded(w), rounded(self.g)
        R = np.asarray(R, float) if np.ndim(R) == 3 else np.repeat(np.asarray(R, float)[:, :, None], N, axis=2)
        R = np.broadcast_to(R, (2, 2, N))
        e, R, w, g = e[:, good], R[:, :, good], w[good], g[:, good]
        self.expected = dict(given=self.given, galaxies=int(good.sum()), **solve(e, g, w, R))
        self.expected["mean"] = list(mean_shear(e, w, R))


def all_layouts():
    every, out = np.ones(N, bool), []

    def add(layout):
        out.append(layout)

    # Responses of each galaxy, weights and flags.
    own = Layout("des-y3", 1)
    (p1, p2), R = own.psf(), own.R
    add(own)
    own.write(dict(coadd_object_id=np.arange(N) + 1.0e9, e_1=own.e[0], e_2=own.e[1], weight=own.w, R11=R[0][0], R12=R[0][1], R21=R[1][0],
                   R22=R[1][1], flags=own.flag, psf_e1=p1, psf_e2=p2, snr=own.random.uniform(10, 90, N)),
              own.e, R, own.flag == 0, own.w)

    own = Layout("unions-uncalibrated", 2, ["e1=e1_uncal", "e2=e2_uncal"])
    (p1, p2), R = own.psf(), own.R
    weights = np.where(np.arange(N) % 10 == 7, 0, own.w)
    add(own)
    own.write(dict(RA=own.random.uniform(0, 1, N), Dec=own.random.uniform(0, 1, N), e1=own.e[0] / 0.7, e2=own.e[1] / 0.7, w_des=weights,
                   e1_uncal=own.e[0], e2_uncal=own.e[1], R_g11=R[0][0], R_g12=R[0][1], R_g21=R[1][0], R_g22=R[1][1], e1_PSF=p1, e2_PSF=p2),
              own.e, R, weights > 0, weights)

    # Shears with weights.
    for name, seed, e1, e2, weight, more in [
        ("euclid", 3, "SHE_LENSMC_E1", "SHE_LENSMC_E2", "SHE_LENSMC_WEIGHT", "SHE_LENSMC_SNR"),
        ("kids-1000", 4, "e1", "e2", "weight", "model_SNratio"),
    ]:
        own = Layout(name, seed)
        shear, weights = own.e / 0.7, np.where(np.arange(N) % 10 == 7, 0, own.w)
        add(own)
        own.write({e1: shear[0], e2: shear[1], weight: weights, more: own.random.uniform(10, 90, N)}, shear, np.eye(2), weights > 0, weights)

    own = Layout("skills", 5, ["e1=AlphaRecalD2_e1", "e2=AlphaRecalD2_e2", "w=AlphaRecalC_weight", "g1=g1_in", "g2=g2_in"])
    (p1, p2), shear, weights = own.psf(), own.e / 0.7, np.where(np.arange(N) % 10 == 7, 0, own.w)
    add(own)
    own.write(dict(NUMBER=np.arange(N) + 1.0, tile_label=100.0 + np.arange(N) // 16, gal_rot=np.zeros(N), e1_LF_r=own.e[0], e2_LF_r=own.e[1],
                   psf_e1_LF_r=p1, psf_e2_LF_r=p2, oldweight_LF_r=own.w, AlphaRecalC_weight=weights, AlphaRecalD2_e1=shear[0],
                   AlphaRecalD2_e2=shear[1], Z_B=own.random.uniform(0.1, 1.2, N), g1_in=own.g[0], g2_in=own.g[1]),
              shear, np.eye(2), weights > 0, weights, truth=False)

    # Distortions, whose mean is divided by twice the responsivity.
    own = Layout("hsc-y3", 6)
    chi, rms = 2 * own.e, own.random.uniform(0.35, 0.4, N)
    stem = "i_hsmshaperegauss_"
    add(own)
    own.write({"object_id": np.arange(N) + 1.0, stem + "e1": chi[0], stem + "e2": chi[1], stem + "derived_weight": own.w,
               stem + "derived_rms_e": rms, stem + "flag": own.flag},
              chi, 2 * (1 - rms**2) * np.eye(2)[:, :, None], own.flag == 0, own.w)

    own = Layout("lsst", 7)
    chi, stem = 2 * own.e, "i_hsmShapeRegauss_"
    square = 0.5 * (chi[0] ** 2 + chi[1] ** 2)
    add(own)
    own.write({"objectId": np.arange(N) + 1.0, stem + "e1": chi[0], stem + "e2": chi[1], stem + "flag": own.flag, stem + "sigma": 0.1 * own.w},
              chi, 2 * (1 - square) * np.eye(2)[:, :, None], own.flag == 0)

    # Moments of BFD: the shear is Q/P over Q Q/P² − R/P.
    own = Layout("bfd", 8, ["e1=Q1/P", "e2=Q2/P", "R11=Q1*Q1/P^2-R11/P", "R12=Q1*Q2/P^2-R12/P", "R21=Q1*Q2/P^2-R12/P", "R22=Q2*Q2/P^2-R22/P"])
    P = own.w
    symmetric = 0.5 * (own.R + own.R.transpose(1, 0, 2))
    Q = own.e * P
    R2 = P * (own.e[:, None] * own.e[None, :] - symmetric)
    add(own)
    own.write(dict(id=np.arange(N), P=P, Q1=Q[0], Q2=Q[1], R11=R2[0][0], R12=R2[0][1], R22=R2[1][1]), own.e, symmetric, every)

    # Metacalibration in columns.
    def metacal(name, seed, e, flags, weight=None, truth=("g1_true", "g2_true"), given=()):
        own = Layout(name, seed, given)
        sheared = {s: own.e + np.einsum("ijn,j->in", own.R, ADDED[s]) for s in ADDED}
        columns = {"id": np.arange(N), flags: own.flag}
        for s in ADDED:
            for k in range(2):
                columns[e(k, s)] = sheared[s][k]
        R, w, good = own.R, None, own.flag == 0
        if weight:
            # Weights of each sheared catalogue, whose response is that of a selection.
            weights = {s: own.w * (1 + np.einsum("jn,j->n", 3 * own.random.normal(size=(2, N)), ADDED[s])) for s in ADDED}
            for s in ADDED:
                columns[weight(s)] = weights[s]
            w = weights["noshear"]
            mean = lambda s: np.sum(weights[s][good] * own.e[:, good], axis=1) / np.sum(weights[s][good])
            of_weights = np.array([(mean(f"{j}p") - mean(f"{j}m")) / (2 * STEP) for j in (1, 2)]).T
            R = R + of_weights[:, :, None]
        named = truth != ("g1_true", "g2_true")
        if named:
            columns |= dict(zip(truth, own.g))
        add(own)
        own.write(columns, own.e, R, good, w, truth=not named)

    metacal("shapepipe", 9, lambda k, s: f"NGMIX_G{k + 1}_{s.upper()}", "NGMIX_MCAL_FLAGS")
    metacal("txpipe", 10, lambda k, s: f"mcal_g{k + 1}" + ("" if s == "noshear" else f"_{s}"), "mcal_flags", truth=("true_g1", "true_g2"))
    metacal("decade", 11, lambda k, s: f"mcal_g_{s}[{k}]", "mcal_flags", lambda s: f"mcal_g_w_{s}",
            given=["w=mcal_g_w_noshear", "flag=mcal_flags"])

    # Metadetection: a row per sheared catalogue, whose means give the response.
    for name, seed, e1, e2, step, flags in [
        ("des-y6", 12, "gauss_g_1", "gauss_g_2", "mdet_step", "mdet_flags"),
        ("metadetect", 13, "wmom_g_1", "wmom_g_2", "shear", "wmom_flags"),
    ]:
        own = Layout(name, seed)
        good, weighted = own.flag == 0, name == "des-y6"
        w = own.w if weighted else np.ones(N)
        sheared = {s: own.e + np.einsum("ijn,j->in", own.R, ADDED[s]) + 0.001 * own.random.normal(size=(2, N)) * (s != "noshear") for s in ADDED}
        mean = lambda s: np.sum((w * sheared[s])[:, good], axis=1) / np.sum(w[good])
        R = np.array([(mean(f"{j}p") - mean(f"{j}m")) / (2 * STEP) for j in (1, 2)]).T
        columns = {step: ["noshear"] * N, e1: own.e[0], e2: own.e[1], flags: own.flag} | ({"w": w} if weighted else {})

        def rows(columns, sheared=sheared, e=(e1, e2), step=step):
            out = []
            for s in ADDED:
                named = columns | {step: [s] * N, e[0]: sheared[s][0], e[1]: sheared[s][1]}
                out += [[named[name][at] for name in named] for at in range(N)]
            return out

        add(own)
        own.write(columns, own.e, R, good, w, rows=rows)
    return out


if __name__ == "__main__":
    expected = {own.name: own.expected for own in all_layouts()}
    (HERE / "layouts.json").write_text(json.dumps(expected, indent=1) + "\n")
