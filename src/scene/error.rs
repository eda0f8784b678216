use std::path::PathBuf;

use crate::sentence::one_line;

/// Why a scene cannot be read. Each message is one sentence that names the file, what is wrong and what to do.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The operating system refused.
    #[error("{}: {source}", path.display())]
    Io { path: PathBuf, source: std::io::Error },
    /// A setting or option that cannot be.
    #[error("{0}")]
    Setting(String),
    /// A file or folder that contradicts itself or the others.
    #[error("{}: {}", path.display(), one_line(what))]
    File { path: PathBuf, what: String },
    /// A line of a text file.
    #[error("{}:{line}: {}", path.display(), one_line(what))]
    Text { path: PathBuf, line: usize, what: String },
    /// A binary file that ends too early.
    #[error(
        "{}: the file ends at byte {length}, within {} (the value at byte {offset} is cut off); copy or export the model again",
        path.display(),
        one_line(record)
    )]
    Truncated { path: PathBuf, length: u64, offset: u64, record: String },
    /// A camera model that is not projected with.
    #[error("{}: camera {id} uses {}; {}", path.display(), one_line(model), hint)]
    CameraModel { path: PathBuf, id: u32, model: String, hint: String },
    /// No sparse model.
    #[error("{0}: no COLMAP model; sparse/0/ (or sparse/) must hold cameras and images, both .bin or both .txt; gscream-vk prepare {0}/images --out SCENE makes one, where colmap is installed", scene.display())]
    NoModel { scene: PathBuf },
    /// A model without points.
    #[error(
        "{}: the model has no points, and the Gaussians are built around them; export points3D.bin, .txt or .ply",
        folder.display()
    )]
    NoPoints { folder: PathBuf },
    /// No photographs.
    #[error("{0}: no pictures in images/; put the photographs (.jpg or .png) there, or make a scene of them: gscream-vk prepare {0} --out SCENE", scene.display())]
    NoImages { scene: PathBuf },
    /// Pictures and model do not belong together.
    #[error(
        "{}: none of the {pictures} pictures is in the model (pictures like {picture}, model images like {image}); the names must agree up to the extension",
        scene.display()
    )]
    NoOverlap { scene: PathBuf, pictures: usize, picture: String, image: String },
    /// A picture that cannot be decoded.
    #[error("{}: not a readable picture: {source}", path.display())]
    Picture { path: PathBuf, source: image::ImageError },
    /// A picture whose proportions are not its camera's.
    #[error(
        "{}: the picture is {}x{} but its camera is {}x{}, and no one scale explains both sides; was it cropped or rotated?",
        path.display(), size[0], size[1], camera[0], camera[1]
    )]
    ImageSize { path: PathBuf, size: [u32; 2], camera: [u32; 2] },
    /// A mask of another size than its picture.
    #[error(
        "{}: the mask is {}x{} but its picture is {}x{}; masks must have the size of their pictures",
        path.display(), size[0], size[1], picture[0], picture[1]
    )]
    MaskSize { path: PathBuf, size: [u32; 2], picture: [u32; 2] },
    /// An inpainted picture of another size than its view's photograph.
    #[error(
        "{}: the inpainted picture is {}x{} but its view is {}x{}; both must have the same size",
        path.display(), size[0], size[1], picture[0], picture[1]
    )]
    ReferenceSize { path: PathBuf, size: [u32; 2], picture: [u32; 2] },
    /// An inpainted picture for no train view.
    #[error("{}: no train view has this name; name the inpainted picture after the view it replaces", path.display())]
    ReferenceWithoutView { path: PathBuf },
    /// A clean view asked for as the reference that the scene does not have.
    #[error(
        "scene.truth_reference is {name}, but {} has {}; name a test view, which shows the place without the object",
        scene.display(), known(names)
    )]
    NoTruth { scene: PathBuf, name: String, names: Vec<String> },
    /// A clean view without a mask, whose hole is not known.
    #[error("{}: scene.truth_reference names this test view, and it has no test mask to say where the object stood", path.display())]
    TruthWithoutMask { path: PathBuf },
    /// A reference view whose mask is missing although other views have one.
    #[error("{}: the inpainted view has no mask; add the mask of {name}, or remove the picture", path.display())]
    ReferenceWithoutMask { path: PathBuf, name: String },
    /// A reference view whose mask is empty.
    #[error("{}: the mask of the reference view is empty, so nothing was inpainted there; is it inverted?", path.display())]
    EmptyReferenceMask { path: PathBuf },
    /// A prior of other proportions than its picture.
    #[error(
        "{}: the prior is {}x{} but its picture is {}x{}; their proportions must agree within 1 %",
        path.display(), size[0], size[1], picture[0], picture[1]
    )]
    PriorSize { path: PathBuf, size: [u32; 2], picture: [u32; 2] },
    /// Infinity in a prior.
    #[error(
        "{}: the value at row {row}, column {column} is {value}; write NaN where there is no prior",
        path.display()
    )]
    NotFinite { path: PathBuf, value: f32, row: usize, column: usize },
}

/// The test views there are, for a message.
fn known(names: &[String]) -> String {
    match names {
        [] => "no test views".to_owned(),
        [one] => format!("only the test view {one}"),
        [first, .., last] => format!("no such test view ({} of them: {first} to {last})", names.len()),
    }
}
