//! The pipeline cache on disk.
//!
//! Drivers read what they stored without doubt: a file that was cut short or written by another one may end the program.
//! So a hash stands before the driver's words, and their header must name the device that is opened.

use std::path::Path;

use super::physical::Identity;

/// Before the hash: what the file is, and its version.
const MAGIC: &[u8] = b"gscream-vk pipelines 1\n";
/// Bytes of Vulkan's header and its version.
const HEADER: usize = 32;
const HEADER_VERSION: u32 = 1;

/// The driver's words in this file; none if they are not whole or another device's.
pub(super) fn read(path: &Path, identity: Identity) -> Vec<u8> {
    let Ok(file) = std::fs::read(path) else { return vec![] };
    let data = unpack(&file).filter(|data| is_of(data, identity));
    if data.is_none() {
        log::info!("{}: another device's kernels, or damaged: they are compiled anew", path.display());
    }
    data.map(<[u8]>::to_vec).unwrap_or_default()
}

/// Writes the driver's words, all or none.
///
/// # Errors
/// When the folder or file cannot be written.
pub(super) fn write(path: &Path, data: &[u8]) -> std::io::Result<()> {
    crate::atomic::write_below(path, [MAGIC, blake3::hash(data).as_bytes(), data].concat())
}

fn unpack(file: &[u8]) -> Option<&[u8]> {
    let (hash, data) = file.strip_prefix(MAGIC)?.split_at_checked(blake3::OUT_LEN)?;
    (blake3::hash(data) == *hash.first_chunk::<{ blake3::OUT_LEN }>()?).then_some(data)
}

/// True if Vulkan's header of the driver's words names this device and driver.
fn is_of(data: &[u8], identity: Identity) -> bool {
    let word = |at: usize| data.get(at..at + 4).and_then(|b| b.first_chunk()).map(|b| u32::from_le_bytes(*b));
    let length = word(0).map_or(0, |n| n as usize);
    (HEADER..=data.len()).contains(&length)
        && word(4) == Some(HEADER_VERSION)
        && word(8) == Some(identity.vendor)
        && word(12) == Some(identity.device)
        && data.get(16..HEADER) == Some(&identity.uuid[..])
}

#[cfg(test)]
mod tests {
    use super::*;

    const IDENTITY: Identity = Identity { vendor: 1, device: 2, uuid: [3; 16] };

    fn words(identity: Identity) -> Vec<u8> {
        let header = [HEADER as u32, HEADER_VERSION, identity.vendor, identity.device];
        [bytemuck::cast_slice(&header.map(u32::to_le)), &identity.uuid, b"kernels".as_slice()].concat()
    }

    #[test]
    fn only_whole_words_of_this_device_are_read() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let path = folder.path().join("cache/pipelines.bin");
        let stored = words(IDENTITY);
        assert_eq!(read(&path, IDENTITY), [0; 0], "no file");
        write(&path, &stored).expect("a writable folder");
        assert_eq!(read(&path, IDENTITY), stored);
        for other in [
            Identity { vendor: 9, ..IDENTITY },
            Identity { device: 9, ..IDENTITY },
            Identity { uuid: [9; 16], ..IDENTITY },
        ] {
            assert_eq!(read(&path, other), [0; 0], "{other:?}");
        }

        let whole = std::fs::read(&path).expect("the file");
        let with = |file: &[u8]| {
            std::fs::write(&path, file).expect("writable");
            read(&path, IDENTITY)
        };
        for length in 0..whole.len() {
            assert_eq!(with(&whole[..length]), [0; 0], "cut after {length} bytes");
        }
        for at in 0..whole.len() {
            let mut damaged = whole.clone();
            damaged[at] ^= 1;
            assert_eq!(with(&damaged), [0; 0], "byte {at}");
        }
        assert_eq!(with(&stored), [0; 0], "the driver's words alone, as earlier versions wrote them");
        assert_eq!(with(&whole), stored);
        for short in [&stored[..HEADER - 1], &[]] {
            write(&path, short).expect("writable");
            assert_eq!(read(&path, IDENTITY), [0; 0], "{} bytes", short.len());
        }
    }
}
