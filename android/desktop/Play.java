import java.io.DataOutputStream;
import java.io.FileOutputStream;
import java.io.IOException;
import java.nio.ByteBuffer;
import java.nio.channels.FileChannel;
import java.nio.file.Paths;
import org.psao.PsaoBuffer;
import org.psao.PsaoClient;
import org.psao.PsaoConfig;
import org.psao.PsaoException;
import org.psao.PsaoFrame;
import org.psao.PsaoResult;

/**
 * The smallest whole use of the Java API, on any Java: plays a recording and looks ambient
 * occlusion up on the CPU, at a grid of positions on a floor, as a picture.
 *
 * <pre>
 * java -cp CLASSES -Djava.library.path=LIBRARY Play RECORDING.psao PICTURE.pgm [INSTANCE HEIGHT]
 * </pre>
 *
 * <p>INSTANCE: whose local space the floor is in; HEIGHT: its local y. 0 and 0 unless given. An
 * engine with a GPU uploads what {@code frame.dirtyRanges} names instead.
 */
public final class Play {
    private static final int SIZE = 256;
    private static final long MOST_BYTES = 1L << 30;

    private Play() {}

    /** Looks all positions up: an engine's shader does the same for each fragment. */
    private static byte[] picture(PsaoClient client, PsaoFrame frame, int instance, float height) {
        if (instance >= frame.count(PsaoFrame.INSTANCES)) {
            throw new IllegalArgumentException("there is no instance " + instance);
        }
        // psao_instance: origin[3], radius, cells_per_unit[3], bucket_first, dims[3], ...
        ByteBuffer instances = frame.buffer(PsaoFrame.INSTANCES);
        int grid = instance * PsaoFrame.elementBytes(PsaoFrame.INSTANCES);
        float[] origin = {instances.getFloat(grid), instances.getFloat(grid + 8)};
        float[] extent = {
            instances.getInt(grid + 32) / instances.getFloat(grid + 16),
            instances.getInt(grid + 40) / instances.getFloat(grid + 24)
        };
        PsaoBuffer positions = new PsaoBuffer(12 * SIZE * SIZE);
        PsaoBuffer normals = new PsaoBuffer(12 * SIZE * SIZE);
        PsaoBuffer openness = new PsaoBuffer(4 * SIZE * SIZE);
        for (int row = 0; row < SIZE; row++) {
            for (int column = 0; column < SIZE; column++) {
                positions.bytes().putFloat(origin[0] + (column + 0.5f) / SIZE * extent[0]);
                positions.bytes().putFloat(height);
                positions.bytes().putFloat(origin[1] + (row + 0.5f) / SIZE * extent[1]);
                normals.bytes().putFloat(0).putFloat(1).putFloat(0);
            }
        }
        client.lookup(instance, positions, normals, SIZE * SIZE, openness);
        byte[] pixels = new byte[SIZE * SIZE];
        for (int i = 0; i < pixels.length; i++) {
            pixels[i] = (byte) Math.round(openness.bytes().getFloat(4 * i) * 255);
        }
        return pixels;
    }

    private static PsaoBuffer read(String path) throws IOException {
        try (FileChannel file = FileChannel.open(Paths.get(path))) {
            PsaoBuffer stream = new PsaoBuffer((int) Math.min(file.size(), Integer.MAX_VALUE));
            while (stream.bytes().hasRemaining() && file.read(stream.bytes()) >= 0) {
                continue;
            }
            stream.bytes().flip();
            return stream;
        }
    }

    private static void play(String path, String out, int instance, float height)
            throws IOException {
        PsaoBuffer stream = read(path);
        PsaoConfig config = PsaoConfig.fromStream(stream);
        if (config == null) {
            throw new IOException(path + " ends before its first packet does");
        }
        // The stream says what a client needs; you say whether it may have it.
        if (config.memoryBytes() > MOST_BYTES) {
            throw new IOException(path + " wants more than 1 GiB");
        }
        int frames = 0;
        byte[] picture = null;
        try (PsaoClient client = new PsaoClient(config)) {
            while (stream.bytes().hasRemaining()) {
                if (client.push(stream, System.nanoTime()) != PsaoResult.OK) {
                    continue;
                }
                PsaoFrame frame = client.take();
                picture = picture(client, frame, instance, height);
                client.release();
                frames++;
            }
        }
        if (picture == null) {
            throw new IOException(path + " has no frames");
        }
        try (DataOutputStream file = new DataOutputStream(new FileOutputStream(out))) {
            file.writeBytes("P5 " + SIZE + " " + SIZE + " 255\n");
            file.write(picture);
        }
        System.out.println(frames + " frames");
    }

    /** See the class. */
    public static void main(String[] words) throws IOException {
        if (words.length != 2 && words.length != 4) {
            System.err.println("usage: Play RECORDING.psao PICTURE.pgm [INSTANCE HEIGHT]");
            System.exit(2);
        }
        boolean floor = words.length == 4;
        try {
            play(words[0], words[1], floor ? Integer.parseInt(words[2]) : 0,
                    floor ? Float.parseFloat(words[3]) : 0);
        } catch (IOException | PsaoException | IllegalArgumentException error) {
            System.err.println(error.getMessage());
            System.exit(1);
        }
    }
}
