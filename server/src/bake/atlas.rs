//! Texture coordinates of a whole scene in one square picture, for textures to be baked to.

use super::Stage;
use glam::Vec2;
use uvunwrap::{Density, MeshInput, Options};

/// Texels an edge of the largest atlas.
pub const MAX_SIZE: u32 = 8192;

/// Texels left free around a chart, so that neither bilinear filtering nor the first mips mix
/// charts.
const GUTTER: u32 = 3;

/// Every instance's triangles in one picture, without overlap.
pub struct Atlas {
    /// Texels an edge.
    pub size: u32,
    /// One an instance of the scene.
    pub instances: Vec<Charts>,
}

/// An instance's triangles in an atlas.
#[derive(Clone, Debug, Default)]
pub struct Charts {
    /// A vertex of the scene's mesh, and where in the atlas it is (0..1, v down); those on the
    /// seams of charts more than once.
    pub vertices: Vec<(u32, Vec2)>,
    /// The mesh's triangles in their order, of these vertices.
    pub triangles: Vec<[u32; 3]>,
}

impl Atlas {
    /// Unwraps all instances as they are posed, all with the same texels a metre. `second_uvs`:
    /// for each instance, texture coordinates to keep the charts of, one a vertex of its mesh, or
    /// none.
    ///
    /// # Errors
    /// A size of no use, or a scene that can't be unwrapped.
    pub fn new(
        stage: &Stage,
        size: u32,
        second_uvs: &[Option<Vec<Vec2>>],
    ) -> Result<Atlas, String> {
        if !(16..=MAX_SIZE).contains(&size) {
            return Err(format!(
                "a texture of {size} texels an edge: give 16 to {MAX_SIZE}"
            ));
        }
        let instances = stage.scene.instances.len() as u32;
        let shapes: Vec<(Vec<[f32; 3]>, &[u32], Option<Vec<[f32; 2]>>)> = (0..instances)
            .map(|instance| {
                let place = &stage.pose.instances[instance as usize].world_from_local;
                let world = |p: &glam::Vec3| place.transform_point3(*p).to_array();
                (
                    stage.vertices(instance).0.iter().map(world).collect(),
                    stage.mesh(instance).triangles.as_flattened(),
                    (second_uvs.get(instance as usize).cloned().flatten())
                        .map(|uvs| uvs.iter().map(Vec2::to_array).collect()),
                )
            })
            .collect();
        let inputs: Vec<MeshInput<'_>> = shapes
            .iter()
            .map(|(positions, indices, uvs)| MeshInput {
                existing_uvs: uvs.as_deref(),
                ..MeshInput::new(positions, indices)
            })
            .collect();
        let options = Options {
            density: Density::Auto { page_size: size },
            padding: GUTTER,
            ..Options::default()
        };
        let failed = |error: String| {
            format!(
                "{}: its surfaces can't be unwrapped: {error}: give a larger --size, or bake its \
                 vertices",
                stage.scene.name
            )
        };
        let unwrapped = uvunwrap::generate(&inputs, &options);
        let unwrapped = unwrapped.map_err(|error| failed(error.to_string()))?;
        if unwrapped.page_count != 1 {
            let (charts, pages) = (unwrapped.chart_count, unwrapped.page_count);
            return Err(failed(format!("its {charts} charts need {pages} textures")));
        }
        let page = Vec2::new(unwrapped.width as f32, unwrapped.height as f32) / size as f32;
        let charts = |mesh: uvunwrap::OutputMesh| Charts {
            vertices: mesh
                .vertices
                .iter()
                .map(|vertex| (vertex.xref, Vec2::from(vertex.uv) * page))
                .collect(),
            triangles: mesh.indices.as_chunks::<3>().0.to_vec(),
        };
        Ok(Atlas {
            size,
            instances: unwrapped.meshes.into_iter().map(charts).collect(),
        })
    }

    /// A picture of the baked texels, row by row from the top: the value of each of `places`, in
    /// their order. Texels of gutters take the mean of the baked ones beside them; what is farther
    /// is `empty`.
    pub fn picture(
        &self,
        places: &[u32],
        values: impl Iterator<Item = f32>,
        empty: f32,
    ) -> Vec<f32> {
        let size = self.size as usize;
        let mut picture = vec![empty; size * size];
        let mut known = vec![false; size * size];
        for (place, value) in places.iter().zip(values) {
            picture[*place as usize] = value;
            known[*place as usize] = true;
        }
        for _ in 0..GUTTER {
            let mut grown = Vec::new();
            for at in (0..size * size).filter(|at| !known[*at]) {
                let (x, y) = (at % size, at / size);
                let around = [
                    (x > 0).then(|| at - 1),
                    (x + 1 < size).then_some(at + 1),
                    (y > 0).then(|| at - size),
                    (y + 1 < size).then_some(at + size),
                ];
                let near = around.into_iter().flatten().filter(|at| known[*at]);
                let (sum, count) = near.fold((0.0, 0u8), |(sum, count), at| {
                    (sum + picture[at], count + 1)
                });
                if count > 0 {
                    grown.push((at, sum / f32::from(count)));
                }
            }
            for (at, value) in grown {
                picture[at] = value;
                known[at] = true;
            }
        }
        picture
    }
}
