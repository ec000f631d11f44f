"""Files of MEDS, as DES writes them."""

import gc
from types import SimpleNamespace

import numpy as np
import pytest
from conftest import same_bits
from test_epochs import SIDE, epoch, galaxies

import shearq

fits = pytest.importorskip("astropy.io.fits", reason="MEDS files are read by astropy")

MOST = 3


def write(path, epochs, box=56, psf=True, ids=None, boxes=None):
    """The epochs as the cutouts of a MEDS file, behind a coadd of zeros; the first galaxy lacks its last epoch."""
    n = len(epochs[0]["stamps"])
    names = ("dudrow", "dudcol", "dvdrow", "dvdcol", "cutout_row", "cutout_col", "orig_row", "orig_col", "start_row", "psf_start_row", "file_id")
    table = {name: np.zeros((n, MOST), "i8" if name.endswith(("start_row", "id")) else "f8") for name in names}
    pixels, weights, stars, masks = [], [], [], []
    at = star_at = 0
    counts = np.full(n, 1 + len(epochs))
    counts[0] -= 1
    for k in range(n):
        for cutout in range(counts[k]):
            one = epochs[max(cutout - 1, 0)]
            stamp, weight = np.zeros((box, box)), np.full((box, box), one["noise"] ** -2.0)
            # The galaxy is off the middle of the cutout.
            row, column = 3, 5
            stamp[row : row + SIDE, column : column + SIDE] = one["stamps"][k] if cutout else 0.0
            centre = (SIDE - 1) / 2 + one["offsets"][k]
            table["cutout_row"][k, cutout], table["cutout_col"][k, cutout] = row + centre[1], column + centre[0]
            matrix = one["wcs"]
            for name, value in zip(("dudcol", "dudrow", "dvdcol", "dvdrow"), matrix.ravel()):
                table[name][k, cutout] = value
            table["start_row"][k, cutout], table["psf_start_row"][k, cutout] = at, star_at
            table["file_id"][k, cutout] = cutout
            table["orig_row"][k, cutout], table["orig_col"][k, cutout] = 10.0 * k, 20.0 * k
            bad = np.zeros((box, box), "i4")
            if k == 2 and cutout == 1:
                bad[3 + 20, 5 + 30] = 4
            pixels.append(stamp.ravel()), weights.append(weight.ravel()), masks.append(bad.ravel())
            stars.append(one["psf"].ravel())
            at, star_at = at + box * box, star_at + one["psf"].size
    side = epochs[0]["psf"].shape[0]
    columns = [fits.Column("id", "K", array=np.arange(n) + 100 if ids is None else ids), fits.Column("ncutout", "K", array=counts)]
    columns += [fits.Column("box_size", "K", array=np.full(n, box)), fits.Column("psf_box_size", "K", array=np.full(n, side))]
    columns += [fits.Column(name, f"{MOST}{'K' if column.dtype.kind == 'i' else 'D'}", array=column) for name, column in table.items()]
    hdus = [fits.PrimaryHDU(), fits.BinTableHDU.from_columns(columns, name="object_data")]
    images = {"image_cutouts": pixels, "weight_cutouts": weights, "bmask_cutouts": masks, **({"psf": stars} if psf else {})}
    for name, parts in images.items():
        hdus.append(fits.ImageHDU(np.concatenate(parts).astype("i4" if name == "bmask_cutouts" else "f8"), name=name))
    fits.HDUList(hdus).writeto(path)
    return counts


@pytest.fixture
def epochs():
    rng = np.random.default_rng(7)
    shapes = galaxies(rng, 12)
    return [epoch(rng, shapes, angle) for angle in (0.0, 0.7)]


def catalogues(*arguments, **more):
    return [shearq.measure(**part) for part in shearq.from_meds(*arguments, **more)]


def test_cutouts_are_measured_as_their_epochs(epochs, tmp_path):
    write(tmp_path / "tile.fits", epochs)
    (found,) = catalogues(tmp_path / "tile.fits", coadd="skip")
    assert found["id"].tolist() == list(range(100, 112))
    # Without the last epoch of the first galaxy, and with a bad pixel. Stamps are cut around the centres, so that the pixels on
    # the borders of some are others.
    epochs[1]["stamps"][0] = np.nan
    epochs[0]["stamps"][2, 20, 30] = np.nan
    expected = shearq.measure(epochs=epochs)
    assert np.array_equal(found["flags"], expected["flags"])
    for name in ("e1", "e2"):
        assert np.allclose(found[name], expected[name], atol=0.02), name
    assert abs((found["e1"] - expected["e1"]).mean()) < 0.005
    blocks = catalogues(tmp_path / "tile.fits", coadd="skip", block=6)
    assert [len(one) for one in blocks] == [6, 6]


def test_objects_with_the_methods_of_meds_are_read(epochs, tmp_path):
    from shearq._meds import _MedsFile

    write(tmp_path / "tile.fits", epochs)
    file = _MedsFile(tmp_path / "tile.fits")
    ways = {name: getattr(file, name) for name in ("get_cat", "has_psf", "get_cutout", "get_psf")}
    (found,) = catalogues(SimpleNamespace(**ways), coadd="skip")
    assert same_bits(found, catalogues(tmp_path / "tile.fits", coadd="skip")[0])


def test_psfs_are_functions_or_models_of_the_files(epochs, tmp_path):
    write(tmp_path / "tile.fits", epochs, psf=False)
    with pytest.raises(ValueError, match="meds: has no extension psf. Try: psfs="):
        shearq.from_meds(tmp_path / "tile.fits", coadd="skip")
    write(tmp_path / "with.fits", epochs)
    (expected,) = catalogues(tmp_path / "with.fits", coadd="skip")
    (found,) = catalogues(tmp_path / "tile.fits", lambda meds, galaxy, cutout: epochs[max(cutout - 1, 0)]["psf"], coadd="skip")
    assert same_bits(found, expected)
    asked = []

    def model(number):
        def draw(x, y):
            asked.append((x, y))
            return epochs[number]["psf"]

        return draw

    (found,) = catalogues(tmp_path / "tile.fits", {1: model(0), 2: model(1)}, coadd="skip")
    assert same_bits(found, expected) and (1.0 + 20 * 3, 1.0 + 10 * 3) in asked
    with pytest.raises(ValueError, match="psfs: none for file_id 2 .galaxy 1, cutout 2"):
        catalogues(tmp_path / "tile.fits", {1: model(0)}, coadd="skip")


def test_psfs_are_profiles_or_images_of_the_files(epochs, tmp_path):
    galsim = pytest.importorskip("galsim", reason="profiles are of GalSim")
    write(tmp_path / "tile.fits", epochs, psf=False)
    profile = galsim.Moffat(beta=3.0, fwhm=3.4).shear(g1=0.05, g2=0.02)
    images = [None, *(profile.drawImage(nx=48, ny=48, wcs=galsim.JacobianWCS(*one["wcs"].ravel()), dtype=float).array for one in epochs)]
    (expected,) = catalogues(tmp_path / "tile.fits", images, coadd="skip")
    for psfs in ([profile] * 3, lambda meds, galaxy, cutout: profile, [None, *map(galsim.Image, images[1:])], lambda meds, galaxy, cutout: images[cutout]):
        assert same_bits(catalogues(tmp_path / "tile.fits", psfs, coadd="skip")[0], expected)
    wrong = [
        (lambda meds, galaxy, cutout: np.ones(3), r"psfs: galaxy 0, cutout 1: psf: found an array of shape \(3,\); expected an image"),
        ([None] * 3, "psfs: galaxy 0, cutout 1: psf: found NoneType; expected an image"),
        (profile, "psfs: found Transformation; expected a function of .meds, galaxy, cutout., or a list or dict"),
    ]
    for psfs, message in wrong:
        with pytest.raises(TypeError, match=message):
            catalogues(tmp_path / "tile.fits", psfs, coadd="skip")


@pytest.mark.filterwarnings("error::ResourceWarning", "error::pytest.PytestUnraisableExceptionWarning")
def test_files_are_closed_and_absent_ones_named(epochs, tmp_path):
    write(tmp_path / "tile.fits", epochs)
    next(iter(shearq.from_meds(tmp_path / "tile.fits", coadd="skip")))
    gc.collect()
    with pytest.raises(FileNotFoundError, match=f"meds: there is no file {tmp_path / 'none.fits'}"):
        shearq.from_meds(tmp_path / "none.fits", coadd="skip")
    (tmp_path / "text.fits").write_text("id,x,y")
    with pytest.raises(ValueError, match="meds: .*text.fits: .*expected a MEDS file"):
        shearq.from_meds(tmp_path / "text.fits", coadd="skip")


def test_bands_are_files_of_the_same_galaxies(epochs, tmp_path):
    for k, one in enumerate(epochs):
        write(tmp_path / f"band{k}.fits", [one, one])
    paths = [tmp_path / "band0.fits", tmp_path / "band1.fits"]
    (found,) = catalogues(paths, coadd="skip", fluxes=[1.0, 1.0])
    assert not found["flags"].any()
    write(tmp_path / "other.fits", epochs, ids=np.arange(12))
    with pytest.raises(ValueError, match="meds: file 1: has 12 galaxies, and not those of file 0"):
        shearq.from_meds([paths[0], tmp_path / "other.fits"], coadd="skip")


def test_wrong_arguments_are_one_error_each(epochs, tmp_path):
    write(tmp_path / "tile.fits", epochs)
    with pytest.raises(ValueError, match="coadd: found 'no'; expected 'skip', 'only' or 'absent'"):
        shearq.from_meds(tmp_path / "tile.fits", coadd="no")
    with pytest.raises(ValueError, match="start: found 12; expected less than 12"):
        shearq.from_meds(tmp_path / "tile.fits", coadd="skip", start=12)
    fits.PrimaryHDU(np.zeros((4, 4))).writeto(tmp_path / "image.fits")
    with pytest.raises(ValueError, match="expected object_data and image_cutouts"):
        shearq.from_meds(tmp_path / "image.fits", coadd="skip")
