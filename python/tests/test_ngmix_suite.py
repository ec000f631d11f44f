"""Files and tables by meds, ngmix and metadetect themselves (https://github.com/esheldon)."""

import numpy as np
import pytest
from conftest import same_bits

import shearq

galsim = pytest.importorskip("galsim", reason="the data are drawn by GalSim")
SCALE = 0.263
PSF = galsim.Moffat(beta=2.5, fwhm=0.9)
SHEAR = 0.02
GRID, STEP = 6, 60
NOISE = 1e-4


def field(rng, shear=SHEAR, noise=NOISE, side=GRID * STEP):
    """Galaxies of S/N 400 on a grid, with their rows and columns."""
    image = galsim.Image(side, side, scale=SCALE, xmin=0, ymin=0)
    places = (np.indices((GRID, GRID)).reshape(2, -1).T + 0.5) * STEP + rng.uniform(-0.5, 0.5, (GRID**2, 2))
    galaxy = galsim.Convolve(galsim.Exponential(half_light_radius=0.5).shear(g1=shear, g2=0.0), PSF)
    for row, column in places:
        galaxy.drawImage(image, center=galsim.PositionD(column, row), add_to_image=True)
    return image.array + rng.normal(0, noise, image.array.shape), places


class Star:
    """What MEDSMaker asks of a model of the PSF."""

    def get_rec(self, row, col):
        return PSF.drawImage(nx=48, ny=48, scale=SCALE).array

    def get_center(self, row, col):
        return 23.5, 23.5


def write_meds(folder, box, monkeypatch):
    """A file by MEDSMaker, of three exposures of the same sky."""
    meds = pytest.importorskip("meds", reason="meds is not installed")
    if not hasattr(meds, "MEDSMaker"):
        pytest.skip("meds is another package")
    fits = pytest.importorskip("astropy.io.fits", reason="needs astropy")
    from astropy.wcs import WCS

    fitsio = pytest.importorskip("fitsio", reason="meds needs fitsio")
    # MEDSMaker writes square cutouts into a mosaic of one dimension, which fitsio 1.4 refuses.
    own = fitsio.hdu.image.ImageHDU.write
    monkeypatch.setattr(
        fitsio.hdu.image.ImageHDU, "write", lambda hdu, image, start=0, **more: own(hdu, image if start is None else image.ravel(), start=start, **more)
    )
    rng = np.random.default_rng(4)
    info = meds.util.get_image_info_struct(3, 200)
    for k in range(3):
        image, places = field(np.random.default_rng(1), noise=0.0)
        image += rng.normal(0, NOISE, image.shape)
        wcs = WCS(naxis=2)
        wcs.wcs.ctype, wcs.wcs.crval, wcs.wcs.crpix = ["RA---TAN", "DEC--TAN"], [10.0, 0.0], [180.5, 180.5]
        wcs.wcs.cd = np.diag([-SCALE / 3600, SCALE / 3600])
        header = wcs.to_header()
        header.update({f"CD{axis}_{axis}": wcs.wcs.cd[axis - 1, axis - 1] for axis in (1, 2)} | {"CD1_2": 0.0, "CD2_1": 0.0})
        weight = np.full(image.shape, NOISE**-2.0)
        # Columns of bad pixels, which a cutout shows.
        weight[:, 150:152] = 0.0
        for name, pixels in (("image", image), ("weight", weight)):
            path = folder / f"{name}{k}.fits"
            fits.writeto(path, pixels.astype("f4"), header)
            info[f"{name}_path"][k] = str(path)
    info["position_offset"] = 1
    objects = meds.util.get_meds_input_struct(len(places))
    objects["id"], objects["box_size"] = np.arange(len(places)), box
    objects["ra"], objects["dec"] = wcs.all_pix2world(places[:, 1], places[:, 0], 0)
    config = {"first_image_is_coadd": False, "check_in_coadd": False, "cutout_types": ["weight"], "psf": {}}
    meds.MEDSMaker(objects, info, psf_data=[Star()] * 3, config=config).write(str(folder / "tile.fits"))
    return folder / "tile.fits"


@pytest.mark.parametrize("box", [32, 48, 56])
def test_files_of_meds_maker_are_read(box, tmp_path, monkeypatch):
    path = write_meds(tmp_path, box, monkeypatch)
    (part,) = shearq.from_meds(path, coadd="absent")
    catalogue = shearq.measure(**part)
    assert len(part["epochs"]) == 3 and (catalogue["flags"] == 0).mean() > 0.8
    # East is to the left: (u, v) has the sign of g1 of the pixels. The noise of the shear is 5e-4.
    shear = shearq.mean_shear(catalogue)
    assert abs(shear.g1 - SHEAR) < 3 * shear.g1_error and abs(shear.g2) < 3 * shear.g2_error and shear.g1_error < 1e-3
    import meds

    with meds.MEDS(str(path)) as file:
        assert same_bits(shearq.measure(**next(iter(shearq.from_meds(file, coadd="absent")))), catalogue)


def test_observations_of_readers_of_ngmix_are_those_of_the_file(tmp_path, monkeypatch):
    readers = pytest.importorskip("ngmix.medsreaders", reason="ngmix is not installed")
    path = write_meds(tmp_path, 32, monkeypatch)
    (part,) = shearq.from_meds(path, coadd="absent")
    file = readers.NGMixMEDS(str(path))
    lists = [file.get_obslist(k) for k in range(file.size)]
    with pytest.raises(ValueError, match="stamps of 32 × 32 pixels; expected at least 48 × 48"):
        shearq.measure(**shearq.from_ngmix(lists))
    found, expected = shearq.measure(**shearq.from_ngmix(lists, size=48)), shearq.measure(**part)
    good = (found["flags"] == 0) & (expected["flags"] == 0)
    assert good.mean() > 0.8 and np.allclose(found["e1"][good], expected["e1"][good], atol=1e-3)


def test_epochs_of_several_and_small_sides_have_the_shear():
    ngmix = pytest.importorskip("ngmix", reason="ngmix is not installed")
    rng = np.random.default_rng(5)
    star = ngmix.Observation(Star().get_rec(0, 0), jacobian=ngmix.DiagonalJacobian(row=23.5, col=23.5, scale=SCALE))
    image, places = field(rng, noise=1e-3)
    lists = []
    for k, (row, column) in enumerate(places):
        side = (32, 40, 44)[k % 3]
        corner = np.rint([row - side / 2, column - side / 2]).astype(int)
        cut = image[corner[0] : corner[0] + side, corner[1] : corner[1] + side]
        jacobian = ngmix.DiagonalJacobian(row=row - corner[0], col=column - corner[1], scale=SCALE)
        lists.append(ngmix.ObsList())
        lists[-1].append(ngmix.Observation(cut, weight=np.full(cut.shape, 1e6), jacobian=jacobian, psf=star))
    with pytest.raises(ValueError, match="expected one shape. Try: size=48"):
        shearq.from_ngmix(lists)
    shear = shearq.mean_shear(shearq.measure(**shearq.from_ngmix(lists, size=48)))
    assert shear.galaxies == len(lists) and abs(shear.g1 - SHEAR) < 3 * shear.g1_error < 0.03




def metacal(rng, shear):
    """As in examples/metacal of ngmix."""
    import ngmix

    fitter = ngmix.gaussmom.GaussMom(fwhm=1.2)
    boot = ngmix.metacal.MetacalBootstrapper(
        runner=ngmix.runners.Runner(fitter=fitter), psf_runner=ngmix.runners.PSFRunner(fitter=fitter), rng=rng, psf="gauss"
    )
    star = ngmix.Observation(Star().get_rec(0, 0), jacobian=ngmix.DiagonalJacobian(row=23.5, col=23.5, scale=SCALE))
    image, places = field(rng, shear)
    rows = []
    for row, column in places:
        corner = np.rint([row - 24, column - 24]).astype(int)
        cut = image[corner[0] : corner[0] + 48, corner[1] : corner[1] + 48]
        jacobian = ngmix.DiagonalJacobian(row=row - corner[0], col=column - corner[1], scale=SCALE)
        found, _ = boot.go(ngmix.Observation(cut, weight=np.full(cut.shape, NOISE**-2.0), jacobian=jacobian, psf=star))
        rows += [(one["flags"], step, one["s2n"], one["e"]) for step, one in found.items()]
    return np.array(rows, dtype=[("flags", "i4"), ("shear_type", "U7"), ("s2n", "f8"), ("g", "f8", 2)])


def metadetect(rng, shear):
    import ngmix
    import numpy.lib.recfunctions
    from metadetect import metadetect
    from metadetect.tests.test_metadetect import TEST_METADETECT_CONFIG as config

    image, _ = field(rng, shear)
    pixels = ngmix.DiagonalJacobian(row=0, col=0, scale=SCALE)
    star = ngmix.Observation(Star().get_rec(0, 0), jacobian=ngmix.DiagonalJacobian(row=23.5, col=23.5, scale=SCALE))
    bits = np.zeros(image.shape, "i4")
    epochs, bands = ngmix.ObsList(), ngmix.MultiBandObsList()
    epochs.append(ngmix.Observation(image, weight=np.full(image.shape, NOISE**-2.0), bmask=bits, ormask=bits, jacobian=pixels, psf=star))
    bands.append(epochs)
    found = metadetect.do_metadetect(config, bands, rng)
    tables = [numpy.lib.recfunctions.append_fields(rows, "shear_type", [step] * len(rows), usemask=False) for step, rows in found.items()]
    return np.hstack(tables)


@pytest.mark.parametrize("run", [metacal, metadetect])
def test_tables_of_metacal_and_metadetect_have_a_bias(run):
    pytest.importorskip("ngmix", reason="ngmix is not installed")
    if run is metadetect:
        pytest.importorskip("metadetect", reason="metadetect is not installed")
        pytest.importorskip("sxdes", reason="metadetect needs sxdes")
    tables = [run(np.random.RandomState(3), shear) for shear in (SHEAR, -SHEAR)]
    cut = {"where": "wmom_s2n > 20 and wmom_T_ratio > 1.2"} if run is metadetect else {}
    found = shearq.bias(tables, g1=[SHEAR, -SHEAR], g2=[0.0, 0.0], **cut)
    # 1σ is 0.002 for metacal and 0.034 for metadetect, whose detections are other ones.
    assert abs(found["m1"]) < 3 * found["m1_error"] < 0.15, found
